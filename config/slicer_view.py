"""A scene of 3D Slicer in which a tool without a pose is hidden: Slicer --python-script THIS.

`anser views SETUP --slicer --out views/` writes it for the devices of a setup. In Slicer a device
keeps its last transform when no more come, so that a withheld pose looks like a tool at rest.
Here whatever is below a device's transform is shown only while its state is ok and poses come.
"""

import qt
import slicer
import vtk

HOST, PORT = '127.0.0.1', 18944
DEVICES = ['tool_a']
SILENT_MS = 500
"""Time without a new transform after which a device is hidden, ms: the connection may be gone."""


class Device:
    """Shows or hides what hangs on one transform."""

    def __init__(self, name):
        scene = slicer.mrmlScene
        self.name, self.state = name, 'no pose yet'
        self.transform = scene.AddNewNodeByClass('vtkMRMLLinearTransformNode', name)
        # The connector fills the nodes that have the names of devices, so they are made before it.
        self.text = scene.AddNewNodeByClass('vtkMRMLTextNode', (name + '/state')[-20:])
        arrow = vtk.vtkArrowSource()
        model = slicer.modules.models.logic().AddModel(arrow.GetOutputPort())
        model.SetName(name + ' axis')
        turned = vtk.vtkTransform()
        turned.RotateY(-90)  # the arrow of VTK is along x, the sensitive axis along z
        turned.Scale(40, 40, 40)
        model.ApplyTransformMatrix(turned.GetMatrix())
        model.SetAndObserveTransformNodeID(self.transform.GetID())
        self.fresh = False
        self.transform.AddObserver(
            slicer.vtkMRMLTransformNode.TransformModifiedEvent, self.on_pose
        )
        self.text.AddObserver(vtk.vtkCommand.ModifiedEvent, self.on_state)
        self.clock = qt.QTimer()
        self.clock.setSingleShot(True)
        self.clock.timeout.connect(self.on_silence)
        self.show()

    def on_pose(self, *_):
        self.fresh = True
        self.clock.start(SILENT_MS)
        self.show()

    def on_state(self, *_):
        state = self.text.GetText()
        if state != self.state:
            self.state = state
            slicer.util.showStatusMessage(f'{self.name}: {state}')
        self.show()

    def on_silence(self):
        self.fresh = False
        slicer.util.showStatusMessage(f'{self.name}: no poses')
        self.show()

    def show(self):
        """Show all that is below the transform while there is a pose."""
        visible = self.fresh and self.state == 'ok'
        for node in slicer.util.getNodesByClass('vtkMRMLDisplayableNode'):
            if node.GetTransformNodeID() == self.transform.GetID():
                node.SetDisplayVisibility(visible)


def begin():
    """Make the nodes and connect; return the devices, which must be kept."""
    devices = [Device(name) for name in DEVICES]
    connector = slicer.mrmlScene.AddNewNodeByClass('vtkMRMLIGTLConnectorNode', 'anser')
    connector.SetTypeClient(HOST, PORT)
    connector.Start()
    return devices


anser_devices = begin()
